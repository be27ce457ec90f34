"""Pictures of an arm: off-screen, in a viewer, as a film."""
