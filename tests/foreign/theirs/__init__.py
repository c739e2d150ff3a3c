"""A package of somebody else's: forewarp uses it and knows nothing of it."""
