"""Arms without torque sensors: servos, rotor inertia and friction from commands and positions."""
