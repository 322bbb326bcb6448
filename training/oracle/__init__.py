"""What scenes are like under any machine, by weighted draws of the context: slow, and unbiased."""
