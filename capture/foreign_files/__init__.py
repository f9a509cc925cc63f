"""Files from elsewhere (checkpoints, initial states): checked before a library reads them or takes memory for them."""
