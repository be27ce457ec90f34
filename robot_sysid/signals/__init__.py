"""From raw samples to signals a regressor can be built on."""
