"""What a result looks like: params.json, the printed block, and the check of a written model."""
