"""Child processes, and the queues between threads.

Code that is slow, or may hang or crash, runs in a process of its own, which `ChildProcess` starts and which
first calls `connect_to_parent`. A `Channel` connects the two: a socket for messages both ways, and a ring of
slots in memory without a name for what is large, such as frames, one way. A frame waits until there is room,
or replaces the oldest. Both are pickled, but only dataclasses of this package can be read: nothing in them is
run. The log is sent too, and a process leaves a heartbeat in the memory: one that leaves none hangs, unless
it had no core. docs/architecture.md lists the processes of a run.

A program ends when the process that started it has finished or died. If it hangs then, a thread of its own
ends it; foreign programs, which have no such thread, are ended by Linux (`with_parent_death_signal`). Every
wait has a limit: a message that does not get through is given up after 15 s.

`BoundedQueue` passes items between threads: frames to be recorded (refused when 240 MB wait, or the source
waits), frames to be shown (the oldest is dropped) or saved (the source waits).
"""
