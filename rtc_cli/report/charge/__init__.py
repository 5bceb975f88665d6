"""Success at equal hardware: rows, figure and page."""
