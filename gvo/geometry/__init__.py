"""Pure functions on arrays: rigid transforms, cameras, robust registration."""
