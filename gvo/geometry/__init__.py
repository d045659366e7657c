"""Pure functions on arrays: rigid transforms, cameras, registration."""
