"""The only home of sockets, timers and signals: one epoll loop per process."""
