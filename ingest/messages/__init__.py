"""Other programs' messages: ROS 2 CDR, JSON and protobuf to images, angles, states, cameras."""
