"""Films by one camera: where what moves begins, and how bodies are tracked."""
