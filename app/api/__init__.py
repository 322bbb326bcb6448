"""The HTTP layer: routes, problem documents (RFC 9457), middleware and documentation pages."""
