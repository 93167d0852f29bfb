"""Pages of one file that need nothing else, and the plots on them."""
