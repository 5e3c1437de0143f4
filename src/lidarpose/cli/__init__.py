"""The command line: one file a command. Each parses, calls a workflow, and prints; nothing heavy is imported early."""
