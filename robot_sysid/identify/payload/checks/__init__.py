"""Whether a payload may be believed: agreement, prediction, plausibility."""
