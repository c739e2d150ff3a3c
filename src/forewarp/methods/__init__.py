"""Methods: what a scene is learned by. Each renders any view at any time, through one contract."""
