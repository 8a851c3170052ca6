"""Pictures of a run: a page (`sgns plot`) and a moving picture (`sgns render`)."""
