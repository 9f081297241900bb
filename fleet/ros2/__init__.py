"""Bridge to ROS 2 nodes over rmw_zenoh."""
