"""The one result: the record, its JSON file, what is printed of it, and what is written from it."""
