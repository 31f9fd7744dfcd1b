"""Reports: self-contained pages and their figures, and the live board."""
