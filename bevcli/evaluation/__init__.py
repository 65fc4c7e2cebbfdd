"""The nuScenes detection metrics, and IoU of BEV maps."""
