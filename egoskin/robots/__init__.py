"""What a robot is: its model, chains and kinematics, and its outer surface."""
