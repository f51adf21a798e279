"""Servers for the processes that docker-compose.yml names."""

from tests.servers import postgres_server, postgres_url, redis_server, redis_space

__all__ = ["postgres_server", "postgres_url", "redis_server", "redis_space"]
