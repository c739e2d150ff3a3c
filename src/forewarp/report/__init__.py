"""From run folders to tables and curves."""
