"""What single commands compute and say: groups, words, objects, time, comparisons, overlays, export."""
