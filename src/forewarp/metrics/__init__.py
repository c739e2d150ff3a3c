"""How good a picture, a depth map or a motion is, by the papers' conventions."""
