"""A ROS 2 node around the tracker of QueST; only :mod:`quest_ros.node` needs ROS."""
