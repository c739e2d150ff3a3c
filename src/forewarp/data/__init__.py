"""Read and write datasets, one file per format, and serve batches from them."""
