"""Child processes, and the queues between threads.

Code that is slow, or may hang or crash, runs in a process of its own:

============================  ==================================  ===================================
program                       answers                             sends besides
============================  ==================================  ===================================
``live.isolated.program``  open, begin                         frames, damaged images
``openni2.oni.player``        play: a description, then images
``datasets.mat_program``      the shapes or arrays of a MATLAB
                              file
``app.view.program``          (gets settings, frames, lines)      opened, status, failure, closed
============================  ==================================  ===================================

`ChildProcess` starts one, which first calls `connect_to_parent`, and a `Channel` connects the two: a socket
for messages, dataclasses that a `Codec` writes as JSON (no pickle: nothing in them is run), and memory
without a name for their arrays, divided into slots. Most messages are a `Call` of a function, by one of the
names that the program gives to `Channel.serve`, and its `Answer`: what the function returns, each item of an
iterator, or the `DriverError` that it raises. The log goes through it too, and a heartbeat: a program that
sends none hangs.

A program ends when the process that started it has finished or died. If it hangs then,
a thread of its own ends it; foreign programs, which have no such thread, are ended by Linux
(`with_parent_death_signal`).

Every wait has a limit: a message that does not get through is given up after 15 s, and a channel is closed
with the process at its other end. Where something is asked for, there is a limit besides: a camera opens
within 60 s, and is lost when its process is silent for 10 s; a player opens within 30 s
and hangs after 10 s; a MATLAB file's frame is read and the view opens within 60 s.

`BoundedQueue` passes items between threads: captured frames (the oldest is dropped, or the source waits),
frames to be recorded (refused when 240 MB wait, or the source waits), frames to be shown (the oldest is
dropped) or saved (the source waits).
"""
