"""Files in and out; nothing else in the package knows a file. Every output is whole or absent."""
