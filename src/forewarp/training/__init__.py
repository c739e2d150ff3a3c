"""The objective, the Lightning module, the stages and what one sees of them."""
