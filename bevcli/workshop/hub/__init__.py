"""Models on the Hugging Face Hub: `hf:OWNER/NAME` as the name of a model, and folders to share."""
