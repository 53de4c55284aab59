"""ROS 2 messages of a run, and bags with them, without ROS."""
