"""Tracking metrics of nuScenes: AMOTA and the numbers that come with it."""
