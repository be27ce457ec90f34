"""What may be believed of an identification."""
