"""What data should be made of: many networks trained on a room, each on other samples."""
