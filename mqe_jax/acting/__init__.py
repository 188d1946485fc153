"""Who acts in environments, and how well."""
