//! Frames on the control stream: a 4-byte little-endian header (bit 31 *ignorable*, bits 0–30 the
//! length), then that many bytes.

use super::codec::DecodeError;

/// Longest frame either end accepts, bytes: a skill model and its envelope.
pub const MAX_FRAME_LEN: usize = 512 * 1024 + 1024;

const IGNORABLE: u32 = 1 << 31;

/// One frame's content.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Frame {
    /// A receiver that does not know the message may skip it.
    pub ignorable: bool,
    /// The encoded message.
    pub payload: Vec<u8>,
}

/// Header and payload as they go onto the stream.
pub fn encode(payload: &[u8], ignorable: bool) -> Vec<u8> {
    debug_assert!(
        payload.len() <= MAX_FRAME_LEN,
        "messages are limited before they are framed"
    );
    let header = payload.len() as u32 | if ignorable { IGNORABLE } else { 0 };
    let mut out = Vec::with_capacity(4 + payload.len());
    out.extend_from_slice(&header.to_le_bytes());
    out.extend_from_slice(payload);
    out
}

/// Cuts a byte stream into frames; holds at most one incomplete frame.
#[derive(Debug, Default)]
pub struct Deframer {
    buffer: Vec<u8>,
}

impl Deframer {
    /// Takes bytes as they arrive.
    pub fn push(&mut self, bytes: &[u8]) {
        self.buffer.extend_from_slice(bytes);
    }

    /// The next complete frame, if there is one.
    ///
    /// # Errors
    /// [`DecodeError::TooLong`] as soon as a header claims more than [`MAX_FRAME_LEN`]; the stream is then dead.
    pub fn next_frame(&mut self) -> Result<Option<Frame>, DecodeError> {
        let Some(header) = self.buffer.first_chunk::<4>() else {
            return Ok(None);
        };
        let header = u32::from_le_bytes(*header);
        let len = (header & !IGNORABLE) as usize;
        if len > MAX_FRAME_LEN {
            return Err(DecodeError::TooLong {
                len,
                limit: MAX_FRAME_LEN,
            });
        }
        if self.buffer.len() < 4 + len {
            return Ok(None);
        }
        let payload = self.buffer[4..4 + len].to_vec();
        self.buffer.drain(..4 + len);
        Ok(Some(Frame {
            ignorable: header & IGNORABLE != 0,
            payload,
        }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_survive_any_fragmentation() {
        let stream = [
            encode(b"one", false),
            encode(b"", true),
            encode(&[7; 300], false),
        ]
        .concat();
        for step in [1, 2, 5, 1000] {
            let (mut deframer, mut frames) = (Deframer::default(), Vec::new());
            for chunk in stream.chunks(step) {
                deframer.push(chunk);
                while let Some(frame) = deframer.next_frame().unwrap() {
                    frames.push(frame);
                }
            }
            assert_eq!(frames.len(), 3);
            assert_eq!(
                (frames[0].payload.as_slice(), frames[0].ignorable),
                (&b"one"[..], false)
            );
            assert_eq!((frames[1].payload.len(), frames[1].ignorable), (0, true));
            assert_eq!(frames[2].payload, [7; 300]);
        }
    }

    #[test]
    fn an_oversized_claim_is_refused_at_its_header() {
        let mut deframer = Deframer::default();
        deframer.push(&(MAX_FRAME_LEN as u32 + 1).to_le_bytes());
        assert!(matches!(
            deframer.next_frame(),
            Err(DecodeError::TooLong { .. })
        ));
    }
}
