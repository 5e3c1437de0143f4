"""The nouns: frozen, typed, and free of files, drawing and estimators."""
