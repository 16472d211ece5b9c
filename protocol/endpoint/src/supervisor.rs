//! What a supervisor (systemd) is told: that a daemon is ready, alive, stopping. Without one, nothing is said.

use std::time::Duration;

use sd_notify::NotifyState;

use crate::Mono;

/// Whoever started the daemon and asked, by `NOTIFY_SOCKET` and `WATCHDOG_USEC`, to hear of it.
#[derive(Debug)]
pub struct Supervisor {
    /// Half of what it waits for a sign of life.
    every: Option<Duration>,
    last: Option<Mono>,
}

impl Supervisor {
    /// By the environment.
    pub fn from_environment() -> Self {
        Self {
            every: sd_notify::watchdog_enabled().map(|span| span / 2),
            last: None,
        }
    }

    /// How often it wants a sign of life, if it does.
    pub fn every(&self) -> Option<Duration> {
        self.every
    }

    /// Everything is up; `status` says in one line what there is.
    pub fn ready(&self, status: &str) {
        say(&[NotifyState::Ready, NotifyState::Status(status)]);
    }

    /// A sign of life at `now`, passed on as often as it is wanted.
    pub fn alive(&mut self, now: Mono) {
        let Some(every) = self.every else { return };
        if self
            .last
            .is_none_or(|last| now.secs_since(last) >= every.as_secs_f64())
        {
            self.last = Some(now);
            say(&[NotifyState::Watchdog]);
        }
    }

    /// The end has begun.
    pub fn stopping(&self) {
        say(&[NotifyState::Stopping]);
    }
}

fn say(state: &[NotifyState<'_>]) {
    // A supervisor that cannot be told will notice by itself.
    let _ = sd_notify::notify(state);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn signs_of_life_are_passed_on_at_half_the_time_allowed() {
        let mut supervisor = Supervisor {
            every: Some(Duration::from_secs(1)),
            last: None,
        };
        let told: Vec<_> = (0..40)
            .filter(|i| {
                let now = Mono(i * 100_000_000);
                supervisor.alive(now);
                supervisor.last == Some(now)
            })
            .collect();
        assert_eq!(told, [0, 10, 20, 30]);
        let mut nobody = Supervisor {
            every: None,
            last: None,
        };
        nobody.alive(Mono(0));
        assert_eq!(nobody.last, None);
    }
}
