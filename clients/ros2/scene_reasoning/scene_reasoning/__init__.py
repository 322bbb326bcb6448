"""What a moving robot knows about a home: a ROS 2 node, and conditions for py_trees."""
