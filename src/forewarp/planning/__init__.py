"""Find out which effects a scene calls for."""
