"""A video, a folder of pictures or a COLMAP model becomes a scene that ``data=video_with_poses`` reads."""
