"""The stages of a run in order: load the model, plan or read, identify, write."""
