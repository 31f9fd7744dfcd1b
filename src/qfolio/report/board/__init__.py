"""The board: a local page that shows the training runs of a folder, live."""
