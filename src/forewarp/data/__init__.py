"""One file a format, each a reader and its writer, and the module that serves rays."""
