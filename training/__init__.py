"""Train models from scenes and publish them in a store. The service never imports this package."""
