//! What every service needs: configuration, session, presence, typed topics, shutdown.
