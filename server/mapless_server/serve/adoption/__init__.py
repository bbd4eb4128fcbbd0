"""Has localized photographs become references: begin with `adopter`; decisions are made in `scenes.adoption`."""
