"""A ROS 2 node that localizes a robot by mapless; its logic is `mapless.ros`."""
