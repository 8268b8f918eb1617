"""What a plan minimises: noise as images or training weigh it, and the processor time that counts."""
