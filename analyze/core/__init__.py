"""What every question is made of: settings, the checked question, the measure, estimates, and the result."""
