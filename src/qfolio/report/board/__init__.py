"""The board: a local page that shows what is trained in a folder, as it happens."""
