//! A thread that other work does not delay: `SCHED_FIFO`, and memory that is not paged out.

use rustix::mm::{MlockAllFlags, mlockall};
use rustix::process::{Resource, getrlimit};
use thread_priority::{
    RealtimeThreadSchedulePolicy, ThreadPriority, ThreadPriorityValue, ThreadSchedulePolicy,
    set_thread_priority_and_policy, thread_native_id,
};

/// A real-time priority, 1 to 99.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Priority(u8);

/// No real-time priority.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("--realtime {number}: a priority is from 1 to 99")]
pub struct NoPriority {
    /// The number given.
    pub number: u8,
}

/// What of a [`Priority`] the system granted, or its reason not to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Realtime {
    /// `SCHED_FIFO` at this priority.
    pub priority: Result<u8, String>,
    /// Whether all memory is locked, or only what was there at the start.
    pub locked: Result<Locked, String>,
}

/// Which memory is never paged out.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Locked {
    /// All of it, for ever.
    All,
    /// What there was at the start: a limit is set, and what would exceed it later could not be had at all.
    Present,
}

impl Priority {
    /// That priority.
    ///
    /// # Errors
    /// [`NoPriority`] for one outside the range.
    pub fn new(number: u8) -> Result<Self, NoPriority> {
        if (1..=99).contains(&number) {
            Ok(Self(number))
        } else {
            Err(NoPriority { number })
        }
    }

    /// Gives it to the calling thread, and locks the process's memory.
    pub fn take(self) -> Realtime {
        let value = ThreadPriorityValue::try_from(self.0).map(ThreadPriority::Crossplatform);
        let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
        let priority = match value {
            Ok(value) => set_thread_priority_and_policy(thread_native_id(), value, policy)
                .map(|()| self.0)
                .map_err(|e| match e {
                    thread_priority::Error::OS(code) => {
                        std::io::Error::from_raw_os_error(code).to_string()
                    }
                    other => format!("{other:?}"),
                }),
            Err(e) => Err(e.to_string()),
        };
        let unlimited = getrlimit(Resource::Memlock).current.is_none();
        let (flags, locked) = if unlimited {
            (MlockAllFlags::CURRENT | MlockAllFlags::FUTURE, Locked::All)
        } else {
            (MlockAllFlags::CURRENT, Locked::Present)
        };
        Realtime {
            priority,
            locked: mlockall(flags).map(|()| locked).map_err(|e| e.to_string()),
        }
    }
}
