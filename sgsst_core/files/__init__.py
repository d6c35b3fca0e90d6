"""Files read and written: PLY scenes, camera files, images; nothing half-written stays."""
