"""What the camera should have seen, each feature with the reason if it is left out."""
