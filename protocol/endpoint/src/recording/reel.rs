//! The file of a recording: chunks that are whole every second, and an end whatever happens.

use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::io::{BufWriter, ErrorKind, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use foxglove::Encode;
use mcap::records::{MessageHeader, Metadata};
use mcap::{McapError, WriteOptions, Writer};
use telemime_protocol::time::Stamp;

use super::{At, FLUSH_S, Outcome, RecordError, nanos};

/// The metadata record that a file begins with.
pub(super) const ABOUT: &str = "telemime";

/// The metadata record that it ends with.
pub(super) const END: &str = "telemime.end";

/// Data end and footer without a summary, as the format has them, before the closing magic.
const BARE_END: [u8; 42] = {
    let mut bytes = [0; 42];
    (bytes[0], bytes[1]) = (0x0f, 4);
    (bytes[13], bytes[14]) = (0x02, 20);
    bytes
};

struct Open {
    writer: Writer<BufWriter<File>>,
    /// The same file, past the buffer.
    file: File,
    channels: BTreeMap<&'static str, (u16, u32)>,
    /// The file is whole up to here.
    good: u64,
}

/// A file being written, or several: one per session clock.
pub(super) struct Reel {
    first: PathBuf,
    path: PathBuf,
    number: u32,
    about: BTreeMap<String, String>,
    open: Option<Open>,
    newest: Stamp,
    flushed: Option<Stamp>,
    unflushed: bool,
    messages: u64,
    /// Of those, in the part of the file that is whole.
    whole: u64,
}

impl Reel {
    /// Begins the file, which must not exist.
    pub(super) fn create(
        path: &Path,
        about: BTreeMap<String, String>,
    ) -> Result<Self, RecordError> {
        Ok(Self {
            open: Some(begin(path, &about)?),
            first: path.to_owned(),
            path: path.to_owned(),
            number: 1,
            about,
            newest: Stamp::ZERO,
            flushed: None,
            unflushed: false,
            messages: 0,
            whole: 0,
        })
    }

    /// Writes a message under `topic`: a `T`, as it is encoded.
    pub(super) fn message<T: Encode>(
        &mut self,
        topic: &'static str,
        at: At,
        encoded: &[u8],
    ) -> Result<(), RecordError> {
        let Some(open) = &mut self.open else {
            return Ok(());
        };
        let done = open.write::<T>(topic, at, encoded);
        self.messages += 1;
        self.newest = self.newest.max(at.log);
        self.flushed.get_or_insert(at.log);
        self.unflushed = true;
        done.map_err(|source| self.failed(source))
    }

    /// Begins another file beside one that has ended: `NAME-2.mcap`, or the next number that is free.
    pub(super) fn another(&mut self) -> Result<(), RecordError> {
        let stem = self.first.file_stem().unwrap_or_default();
        let stem = stem.to_string_lossy().into_owned();
        let (path, open) = loop {
            self.number += 1;
            let name = format!("{stem}-{}.mcap", self.number);
            let path = self.first.with_file_name(name);
            match begin(&path, &self.about) {
                Ok(open) => break (path, open),
                Err(RecordError::Exists { .. }) if self.number < 10_000 => {}
                Err(e) => return Err(e),
            }
        };
        (self.path, self.open) = (path, Some(open));
        (self.newest, self.flushed, self.unflushed) = (Stamp::ZERO, None, false);
        (self.messages, self.whole) = (0, 0);
        Ok(())
    }

    /// Completes the chunk if it is a second old, or if there is time.
    pub(super) fn flush(&mut self, idle: bool) -> Result<(), RecordError> {
        let due = self
            .flushed
            .is_some_and(|at| self.newest.secs_since(at) >= FLUSH_S);
        let Some(open) = self
            .open
            .as_mut()
            .filter(|_| self.unflushed && (due || idle))
        else {
            return Ok(());
        };
        (self.flushed, self.unflushed) = (Some(self.newest), false);
        let done = open.flush();
        done.map_err(|source| self.failed(source))?;
        self.whole = self.messages;
        Ok(())
    }

    /// Ends the file; with an `error`, where it last was whole.
    pub(super) fn end(&mut self, dropped: u64, error: Option<RecordError>) -> Outcome {
        let error = match (self.open.take(), error) {
            (Some(open), None) => {
                let about = BTreeMap::from([
                    ("messages".to_owned(), self.messages.to_string()),
                    ("dropped".to_owned(), dropped.to_string()),
                ]);
                open.finish(about).err().map(|source| self.failed(source))
            }
            (Some(open), Some(error)) => {
                open.abandon();
                Some(error)
            }
            (None, error) => error,
        };
        Outcome {
            path: self.path.clone(),
            messages: if error.is_some() {
                self.whole
            } else {
                self.messages
            },
            dropped,
            error,
        }
    }

    fn failed(&self, source: McapError) -> RecordError {
        failed(&self.path, source)
    }
}

fn failed(path: &Path, source: McapError) -> RecordError {
    let path = path.to_owned();
    match source {
        McapError::Io(source) => RecordError::Write { path, source },
        source => RecordError::Format { path, source },
    }
}

fn begin(path: &Path, about: &BTreeMap<String, String>) -> Result<Open, RecordError> {
    let create = |source: std::io::Error| match source.kind() {
        ErrorKind::AlreadyExists => RecordError::Exists {
            path: path.to_owned(),
        },
        _ => RecordError::Create {
            path: path.to_owned(),
            source,
        },
    };
    let mut options = OpenOptions::new();
    let file = options
        .write(true)
        .create_new(true)
        .open(path)
        .map_err(create)?;
    let beyond = file.try_clone().map_err(create)?;
    let settings = WriteOptions::new()
        .compression(compression())
        .profile("")
        .library(concat!("telemime ", env!("CARGO_PKG_VERSION")))
        // A chunk is in memory until it is complete, so that a file that ends anywhere has no torn one but the last.
        .disable_seeking(true);
    let writer = settings.create(BufWriter::new(file));
    let open = writer.and_then(|writer| {
        let mut open = Open {
            writer,
            file: beyond,
            channels: BTreeMap::new(),
            good: 0,
        };
        open.metadata(ABOUT, about.clone())?;
        open.flush()?;
        Ok(open)
    });
    open.map_err(|source| {
        // A file of ours, and nothing in it.
        let _ = std::fs::remove_file(path);
        failed(path, source)
    })
}

#[cfg(feature = "compression")]
fn compression() -> Option<mcap::Compression> {
    Some(mcap::Compression::Zstd)
}

#[cfg(not(feature = "compression"))]
fn compression() -> Option<mcap::Compression> {
    None
}

impl Open {
    fn write<T: Encode>(
        &mut self,
        topic: &'static str,
        at: At,
        data: &[u8],
    ) -> Result<(), McapError> {
        let (channel_id, sequence) = match self.channels.get_mut(topic) {
            Some((id, sequence)) => {
                *sequence = sequence.wrapping_add(1);
                (*id, *sequence)
            }
            None => {
                let schema = T::get_schema().map_or(Ok(0), |schema| {
                    self.writer
                        .add_schema(&schema.name, &schema.encoding, &schema.data)
                })?;
                let encoding = T::get_message_encoding();
                let id = self
                    .writer
                    .add_channel(schema, topic, &encoding, &BTreeMap::new())?;
                self.channels.insert(topic, (id, 0));
                (id, 0)
            }
        };
        let header = MessageHeader {
            channel_id,
            sequence,
            log_time: nanos(at.log),
            publish_time: nanos(at.publish),
        };
        self.writer.write_to_known_channel(&header, data)
    }

    fn metadata(
        &mut self,
        name: &str,
        metadata: BTreeMap<String, String>,
    ) -> Result<(), McapError> {
        self.writer.write_metadata(&Metadata {
            name: name.to_owned(),
            metadata,
        })
    }

    fn flush(&mut self) -> Result<(), McapError> {
        self.writer.flush()?;
        self.good = self.file.stream_position()?;
        Ok(())
    }

    /// As it should be, with a summary by which readers find their way.
    fn finish(mut self, last: BTreeMap<String, String>) -> Result<(), McapError> {
        let done = self
            .flush()
            .and_then(|()| self.metadata(END, last))
            .and_then(|()| self.writer.finish());
        let mut inner = self.writer.into_inner();
        let done = done.and_then(|_| Ok(inner.flush()?));
        if done.is_err() {
            cut(inner, self.file, self.good);
        }
        done
    }

    fn abandon(self) {
        cut(self.writer.into_inner(), self.file, self.good);
    }
}

/// What is torn is cut off. The rest is a file without a summary, which every reader takes.
fn cut(inner: BufWriter<File>, mut file: File, good: u64) {
    // What is still in the buffer is part of what is torn.
    let (_, _unwritten) = inner.into_parts();
    let closed = file
        .set_len(good)
        .and_then(|()| file.seek(SeekFrom::Start(good)))
        .and_then(|_| file.write_all(&BARE_END))
        .and_then(|()| file.write_all(mcap::MAGIC));
    // Where there is no room even for that, a reader that recovers finds all of it.
    drop(closed);
}
