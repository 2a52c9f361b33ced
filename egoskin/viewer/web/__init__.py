"""A page in the browser: a robot, its skin, and balls to throw at it."""
