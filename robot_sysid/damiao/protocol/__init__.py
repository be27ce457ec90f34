"""What Damiao motors are and what their CAN frames mean; needs no bus."""
