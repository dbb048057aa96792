"""What is read: archives, images, geometry and catalogues, with their small text data beside the loaders."""
