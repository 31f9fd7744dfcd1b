"""Reports: self-contained pages and their figures, tables in the terminal, and the live board."""
