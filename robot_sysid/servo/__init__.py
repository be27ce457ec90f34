"""An arm without torque sensors: servos, friction and rotor inertia from commands and positions."""
