"""What lets a run go on where it was interrupted: a journal, and the replay of it."""
