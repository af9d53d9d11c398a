"""Episodes of several teams at once."""
