//! The person at the terminal.

use std::borrow::Cow;
use std::future::Future;
use std::pin::pin;

use telemime_endpoint::cli::Word;
use telemime_protocol::time::Stamp;
use tokio::sync::{mpsc, watch};

use super::said::Notice;
use crate::console::Act;
use crate::input::Driver;
use crate::task::Task;

pub(super) const NOT_HERE: &str =
    "an operator is paired by `telemime pair HOST:PORT`, a robot on its own terminal";

/// What the person at the terminal says.
pub(super) struct Console<'a> {
    pub(super) quit: &'a mut watch::Receiver<bool>,
    pub(super) words: &'a mut mpsc::UnboundedReceiver<Word>,
    pub(super) notices: &'a mpsc::UnboundedSender<Notice>,
}

impl Console<'_> {
    /// Does `work` while nobody can be told: a stop is kept in `stop`, a reset is not.
    pub(super) async fn beside<T>(
        &mut self,
        now: impl Fn() -> Stamp,
        task: &mut Task,
        stop: &mut bool,
        work: impl Future<Output = T>,
    ) -> T {
        let mut work = pin!(work);
        loop {
            tokio::select! {
                biased;
                heard = task.hear() => {
                    match task.handle(now(), heard, None) {
                        Some(Act::Stop) => *stop = true,
                        Some(Act::Shape(shape)) => drop(self.notices.send(Notice::LinkAsked(shape))),
                        // Refused without a session.
                        Some(Act::Learn { .. } | Act::Use(_)) | None => {}
                    }
                    self.tell(task);
                }
                Some(word) = self.words.recv() => self.note(match word {
                    Word::Stop => {
                        *stop = true;
                        "there is no link: the emergency stop is the first thing the robot will hear"
                    }
                    Word::Reset => "there is no link: the reset is discarded",
                    Word::BlackBox | Word::Pair(_) | Word::Yes | Word::No => NOT_HERE,
                    Word::Engage | Word::Release | Word::Keep | Word::Refine | Word::Save(_) => {
                        "there is no link: say it again when it is back"
                    }
                }),
                done = &mut work => return done,
            }
        }
    }

    /// What the input has to tell.
    pub(super) fn tell(&self, task: &mut Task) {
        while let Some(note) = task.driver().and_then(Driver::poll_note) {
            self.note(note);
        }
    }

    pub(super) fn note(&self, text: impl Into<Cow<'static, str>>) {
        let _ = self.notices.send(Notice::Note(text.into()));
    }
}
