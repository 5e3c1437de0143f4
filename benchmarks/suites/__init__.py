"""The suites: each a module with `run(effort) -> Report`, run in a process of its own by `benchmarks.run`."""
