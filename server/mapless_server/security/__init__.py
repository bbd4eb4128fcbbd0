"""Who may call: tokens, encryption, what may be listened on, and how much each tenant may use."""
