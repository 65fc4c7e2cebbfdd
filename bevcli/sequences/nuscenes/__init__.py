"""nuScenes datasets."""
