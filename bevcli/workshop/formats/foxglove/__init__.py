"""Drives and boxes as an MCAP file for Foxglove and ROS 2."""
