"""The equations of a question: made of sums, and solved."""
