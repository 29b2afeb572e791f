"""What is asked of one state: accelerations, constraint forces, power, and the equations reduced by ignorable coordinates."""
