"""What is known of a pose beforehand (`known`), and poses that use it: `gravity`, `informed`, `pose_only`."""
