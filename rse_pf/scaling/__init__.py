"""Pure rules: when servers count as busy, idle or broken, and what to do about it."""
