"""What a run may take: a trial of its first replans, and the largest recording that fits into a budget."""
