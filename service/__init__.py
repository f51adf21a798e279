"""Rules, storage and HTTP. Jobs are sent by name: nothing here imports models, workers, torch or a simulator."""
