"""Results in other forms: messages, documents, text, notebooks, python-control."""
