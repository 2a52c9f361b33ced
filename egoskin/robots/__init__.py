"""Robots: model, kinematic chain, kinematics and outer surface."""
