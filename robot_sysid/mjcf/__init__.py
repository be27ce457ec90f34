"""The model file as text: read safely, searched, rewritten for another folder."""
