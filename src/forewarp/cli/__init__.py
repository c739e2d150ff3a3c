"""The six commands, and what only they need."""
