"""From square-root information to estimates and what is known about their errors."""
