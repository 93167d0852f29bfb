"""What belongs to the paper alone, kept to compare with: its first tracker and its classifier."""
