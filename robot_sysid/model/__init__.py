"""What MuJoCo makes of a model file: chain, limits, inertias, contacts."""
