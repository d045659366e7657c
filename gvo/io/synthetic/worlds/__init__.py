"""The rendered worlds: a street to drive through, a room to look around in."""
