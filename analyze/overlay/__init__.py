"""`vla-analyze overlay`: attention on the stored pictures, as strips and videos."""
