"""What several tests share: small stores, random rows, golden cases, stand-ins for tokenizers."""
