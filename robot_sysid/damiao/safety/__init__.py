"""What keeps an arm safe: which samples are believed, how far commands may go, what disagrees."""
