"""Readers and writers of scenes, cameras and images. Files are written atomically."""
