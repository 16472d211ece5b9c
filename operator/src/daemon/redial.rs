//! Until there is a session.

use quinn::Endpoint;
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::hello::RejectCode;

use super::console::Console;
use super::said::{DaemonError, Notice};
use super::{Daemon, SOCKET_PATIENCE_S};
use crate::dial::{DialError, Dialler, Link, Seen};
use crate::task::Task;

impl Daemon {
    /// Dials until there is a session; `None` once the task is over anyway and no `stop` has to be delivered.
    /// `seen` is what the last session's link was like, if there was one.
    pub(super) async fn dial(
        &self,
        endpoint: &mut Endpoint,
        seen: Option<Seen>,
        task: &mut Task,
        console: &mut Console<'_>,
        stop: &mut bool,
    ) -> Result<Option<Link>, DaemonError> {
        let (begun, first, addr) = (self.now(), seen.is_none(), self.robot);
        let mut dialler = Dialler::new(endpoint, addr, self.config.versions, seen);
        let (mut said, mut bound) = (None, begun);
        loop {
            let outcome = console
                .beside(|| self.now(), task, stop, dialler.next())
                .await;
            let patient = self.now().secs_since(begun) <= self.patience.as_secs_f64();
            let why = match outcome {
                Some(Ok(link)) => return Ok(Some(link)),
                None => None,
                Some(Err(DialError::Again(why))) => Some(why),
                Some(Err(DialError::NoSocket)) => {
                    bound = Stamp(i64::MIN);
                    Some("our socket has failed".into())
                }
                // An operator that lost its link, or comes back, may find its own old session still in authority.
                Some(Err(DialError::Rejected {
                    code: RejectCode::Busy,
                    text,
                })) if !first || patient => Some(text),
                Some(Err(DialError::Rejected { code, text })) => {
                    return Err(DaemonError::Rejected { addr, code, text });
                }
                Some(Err(DialError::KeyChanged)) => {
                    let shown = self.trust.turned_away();
                    let changed = DaemonError::KeyChanged { addr, shown };
                    if first {
                        return Err(changed);
                    }
                    // Whoever answers in its place now need not be there for long.
                    Some(changed.to_string())
                }
                Some(Err(DialError::Revoked)) => return Err(DaemonError::Revoked { addr }),
            };
            if self.now().secs_since(bound) > SOCKET_PATIENCE_S
                && (!first || bound.0 == i64::MIN)
                && let Some(reopen) = &self.reopen
            {
                bound = self.now();
                match (reopen.0)() {
                    Ok(other) => {
                        *endpoint = other;
                        dialler.move_to(endpoint);
                    }
                    Err(e) => console.note(format!("no other socket to be had: {e}")),
                }
            }
            if first && !patient {
                let why = why.or(said);
                let why = why.unwrap_or_else(|| "no answer".into());
                return Err(DaemonError::Unreachable { addr, why });
            }
            if task.is_over(self.now()) && !*stop {
                return Ok(None);
            }
            if why.is_some() && why != said {
                said.clone_from(&why);
                let why = why.unwrap_or_default();
                let _ = console.notices.send(Notice::Dialling { why });
            }
        }
    }
}
