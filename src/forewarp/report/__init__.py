"""Turn run folders into tables, curves and pages."""
