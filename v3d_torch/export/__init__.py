"""Exports for other tools: ROS 2 messages and bags, static recordings, nerfstudio and COLMAP folders."""
