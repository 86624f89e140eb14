"""Child processes, and the queues between threads.

Code that is slow, or may hang or crash, runs in a process of its own:

===========================  =====================================  ==========================================
program                      gets                                   sends
===========================  =====================================  ==========================================
``drivers.process.program``  a source to open, then orders: read,   what was opened, frames, what was lost,
                             pause, seek, record ...                damaged and recorded, why it ended
``openni2.oni.player``       a file                                 a description, images, the end
``app.view.program``         settings, frames, lines, states        what it shows, commands, failures
===========================  =====================================  ==========================================

`ChildProcess` starts one, which first calls `connect_to_parent`, and a `Channel` connects the two: a socket
for messages both ways, and a ring of slots in memory without a name for what is large, such as frames, one
way. A frame waits until there is room, or replaces the oldest. Messages are pickled, but only dataclasses of
this package can be read: nothing in them is run. The log is sent too, and a process leaves a heartbeat in the
memory: one that leaves none hangs, unless it had no core.

A program ends when the process that started it has finished or died. If it hangs then, a thread of its own
ends it; foreign programs, which have no such thread, are ended by Linux (`with_parent_death_signal`).

Every wait has a limit: a message that does not get through is given up after 15 s, and a channel is closed
with the process at its other end. A camera opens within 60 s, a recording within 600 s, and each is lost when
its process leaves no heartbeat for 10 s; the view opens within 60 s.

`BoundedQueue` passes items between threads: frames to be recorded (refused when 240 MB wait, or the source
waits), frames to be shown (the oldest is dropped) or saved (the source waits).
"""
