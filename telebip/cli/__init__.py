"""The commands behind `scripts/`. Each parses its arguments before it imports torch, so that `--help` is quick."""
