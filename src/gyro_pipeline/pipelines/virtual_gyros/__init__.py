"""Virtual gyroscopes, Dataset-3 and Dataset-4: simulated recordings like the real ones."""
