"""Parts of the documentation's build."""
