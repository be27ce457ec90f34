"""The one fit: a torque is a sum of terms, and every question is a list of terms."""
