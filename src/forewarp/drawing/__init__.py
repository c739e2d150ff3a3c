"""Draw and write images and videos."""
