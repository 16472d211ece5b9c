//! Recordings read back, record by record: a file that was cut off gives all that was written whole.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, ErrorKind, Read};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};

use mcap::McapError;
use mcap::records::Record;
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};
use telemime_protocol::time::Stamp;

use super::At;

/// Nothing in a recording of ours comes near; what claims more is not read.
const MAX_RECORD: usize = 64 << 20;

/// Why a recording cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum ReadError {
    /// The system's.
    #[error("cannot read {}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// It is something else.
    #[error("{}: this is no MCAP file", path.display())]
    NotMcap {
        /// The file.
        path: PathBuf,
    },
    /// It is compressed in a way that this build does not know.
    #[error("{}: compressed as {how}, which this build cannot read: build with --features compression, or run `mcap compress --compression none`", path.display())]
    Compressed {
        /// The file.
        path: PathBuf,
        /// How.
        how: String,
    },
    /// Its lengths contradict each other.
    #[error("{}: the lengths that stand in this file cannot be; record it again", path.display())]
    Forged {
        /// The file.
        path: PathBuf,
    },
    /// The system or the library has trouble in the middle.
    #[error("{}: after {messages} messages: {source}; `mcap recover` may save more", path.display())]
    Broken {
        /// The file.
        path: PathBuf,
        /// Messages before it.
        messages: u64,
        /// What is wrong.
        source: McapError,
    },
}

/// A message as it stands in a file.
#[derive(Debug, Clone, Copy)]
pub struct Message<'a> {
    /// Its topic.
    pub topic: &'a str,
    /// Its schema's name; empty if it has none.
    pub schema: &'a str,
    /// How it is encoded: `json` or `protobuf`.
    pub encoding: &'a str,
    /// Its times.
    pub at: At,
    /// It.
    pub data: &'a [u8],
}

/// What there was to read.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Contents {
    /// Messages.
    pub messages: u64,
    /// Metadata records, by name.
    pub metadata: BTreeMap<String, BTreeMap<String, String>>,
    /// The file ends as it should: whoever wrote it was not killed.
    pub complete: bool,
}

struct Channel {
    topic: String,
    schema: u16,
    encoding: String,
}

/// Calls `each` for every message of `path`, in the order of the file.
///
/// # Errors
/// [`ReadError`]; a file that is only cut off is none.
pub fn read(path: &Path, each: impl FnMut(Message<'_>)) -> Result<Contents, ReadError> {
    // The library subtracts lengths that a forged file states; where overflow is checked, that is a panic.
    let read = AssertUnwindSafe(|| read_records(path, each));
    catch_unwind(read).unwrap_or_else(|_| {
        Err(ReadError::Forged {
            path: path.to_owned(),
        })
    })
}

fn read_records(path: &Path, mut each: impl FnMut(Message<'_>)) -> Result<Contents, ReadError> {
    let io = |source| ReadError::Io {
        path: path.to_owned(),
        source,
    };
    let mut file = BufReader::new(File::open(path).map_err(io)?);
    let options = LinearReaderOptions::default()
        // With the limit this bounds what a chunk may claim, and a damaged one is not looked into.
        .with_prevalidate_chunk_crcs(true)
        .with_record_length_limit(MAX_RECORD);
    let mut reader = LinearReader::new_with_options(options);
    let mut contents = Contents::default();
    let mut channels: BTreeMap<u16, Channel> = BTreeMap::new();
    let mut schemas: BTreeMap<u16, String> = BTreeMap::new();
    while let Some(event) = reader.next_event() {
        let broken = |source, messages| match source {
            McapError::BadMagic if messages == 0 => ReadError::NotMcap {
                path: path.to_owned(),
            },
            McapError::UnsupportedCompression(how) => ReadError::Compressed {
                path: path.to_owned(),
                how,
            },
            source => ReadError::Broken {
                path: path.to_owned(),
                messages,
                source,
            },
        };
        let event = match event {
            Ok(event) => event,
            // Cut off: so far it was whole.
            Err(McapError::UnexpectedEof | McapError::UnexpectedEoc)
                if !contents.metadata.is_empty() || contents.messages > 0 =>
            {
                return Ok(contents);
            }
            Err(McapError::Io(e))
                if e.kind() == ErrorKind::UnexpectedEof && contents.messages > 0 =>
            {
                return Ok(contents);
            }
            Err(McapError::UnexpectedEof) => {
                return Err(ReadError::NotMcap {
                    path: path.to_owned(),
                });
            }
            Err(e) => return Err(broken(e, contents.messages)),
        };
        let (opcode, data) = match event {
            LinearReadEvent::ReadRequest(need) => {
                let got = file.read(reader.insert(need)).map_err(io)?;
                reader.notify_read(got);
                continue;
            }
            LinearReadEvent::Record { opcode, data } => (opcode, data),
        };
        let record = mcap::parse_record(opcode, data).map_err(|e| broken(e, contents.messages))?;
        match record {
            Record::Schema { header, .. } => {
                schemas.insert(header.id, header.name);
            }
            Record::Channel(channel) => {
                let known = Channel {
                    topic: channel.topic,
                    schema: channel.schema_id,
                    encoding: channel.message_encoding,
                };
                channels.insert(channel.id, known);
            }
            Record::Message { header, data } => {
                contents.messages += 1;
                let Some(channel) = channels.get(&header.channel_id) else {
                    continue;
                };
                let stamp = |ns: u64| Stamp(i64::try_from(ns).unwrap_or(i64::MAX));
                each(Message {
                    topic: &channel.topic,
                    schema: schemas.get(&channel.schema).map_or("", String::as_str),
                    encoding: &channel.encoding,
                    at: At {
                        log: stamp(header.log_time),
                        publish: stamp(header.publish_time),
                    },
                    data: &data,
                });
            }
            Record::Metadata(metadata) => {
                contents.metadata.insert(metadata.name, metadata.metadata);
            }
            Record::Footer(_) => contents.complete = true,
            _ => {}
        }
    }
    Ok(contents)
}
