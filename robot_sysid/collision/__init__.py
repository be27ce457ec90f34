"""What an arm must not touch, and how near it comes."""
