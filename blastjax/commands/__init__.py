"""The commands of `python -m blastjax`, one module each."""
