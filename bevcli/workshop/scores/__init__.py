"""The nuScenes devkit's scores of tracks, and plots of detection scores."""
