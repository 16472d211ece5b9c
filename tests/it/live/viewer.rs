//! A viewer's end of the WebSocket: what it is told, parsed, and what it asks for.

use std::collections::BTreeMap;
use std::io::ErrorKind;
use std::net::TcpStream;
use std::time::Duration;

use serde_json::{Value, json};
use tungstenite::client::IntoClientRequest;
use tungstenite::http::HeaderValue;
use tungstenite::{Error, Message, WebSocket, client};

/// A topic that is offered.
pub(super) struct Channel {
    id: u64,
    pub(super) topic: String,
    pub(super) schema: String,
}

/// What a viewer is told.
pub(super) enum Said {
    Info(Value),
    Advertised(Vec<Channel>),
    Unadvertised,
    /// A refusal.
    Status(String),
    Message {
        topic: String,
        /// Log time, ns.
        t: u64,
        data: Vec<u8>,
    },
}

pub(super) struct Viewer {
    socket: WebSocket<TcpStream>,
    info: Value,
    topics: BTreeMap<u32, String>,
}

impl Viewer {
    /// Connects, and hears who serves.
    pub(super) fn connect(url: &str) -> Result<Self, Box<dyn std::error::Error>> {
        let stream = TcpStream::connect(url.trim_start_matches("ws://"))?;
        let mut request = url.into_client_request()?;
        request.headers_mut().insert(
            "sec-websocket-protocol",
            HeaderValue::from_static("foxglove.sdk.v1"),
        );
        let (socket, answer) = client(request, stream).map_err(|e| e.to_string())?;
        assert_eq!(
            answer.headers()["sec-websocket-protocol"],
            "foxglove.sdk.v1"
        );
        let mut viewer = Self {
            socket,
            info: Value::Null,
            topics: BTreeMap::new(),
        };
        match viewer.next() {
            Some(Said::Info(info)) => viewer.info = info,
            _ => return Err("no serverInfo".into()),
        }
        Ok(viewer)
    }

    /// What the server said of itself.
    pub(super) fn info(&self) -> &Value {
        &self.info
    }

    pub(super) fn subscribe(&mut self, channel: &Channel) {
        let id = u32::try_from(self.topics.len()).unwrap();
        self.topics.insert(id, channel.topic.clone());
        let wish =
            json!({"op": "subscribe", "subscriptions": [{"id": id, "channelId": channel.id}]});
        self.say(&wish.to_string());
    }

    pub(super) fn say(&mut self, text: &str) {
        self.socket.send(Message::text(text)).unwrap();
    }

    /// What comes next; nothing if the connection is over.
    pub(super) fn next(&mut self) -> Option<Said> {
        loop {
            let message = self.socket.read().ok()?;
            if let Some(said) = self.understood(&message) {
                return Some(said);
            }
        }
    }

    /// What comes within the time that is waited for.
    pub(super) fn poll(&mut self) -> Option<Said> {
        match self.socket.read() {
            Ok(message) => self.understood(&message),
            Err(Error::Io(e))
                if matches!(e.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) =>
            {
                None
            }
            Err(e) => panic!("{e}"),
        }
    }

    pub(super) fn no_longer_than(&mut self, patience: Duration) {
        let stream = self.socket.get_mut();
        stream.set_read_timeout(Some(patience)).unwrap();
    }

    pub(super) fn for_ever(&mut self) {
        self.socket.get_mut().set_read_timeout(None).unwrap();
    }

    fn understood(&self, message: &Message) -> Option<Said> {
        match message {
            Message::Text(text) => {
                let value: Value = serde_json::from_str(text).unwrap();
                Some(match value["op"].as_str().unwrap() {
                    "serverInfo" => Said::Info(value),
                    "advertise" => {
                        let channels = value["channels"].as_array().unwrap().iter();
                        Said::Advertised(channels.map(channel).collect())
                    }
                    "unadvertise" => Said::Unadvertised,
                    "status" => Said::Status(value["message"].to_string()),
                    "fetchAssetResponse" => Said::Status(value.to_string()),
                    other => panic!("{other}: {value}"),
                })
            }
            Message::Binary(bytes) if bytes[0] == 1 => {
                let id = u32::from_le_bytes(bytes[1..5].try_into().unwrap());
                Some(Said::Message {
                    topic: self.topics[&id].clone(),
                    t: u64::from_le_bytes(bytes[5..13].try_into().unwrap()),
                    data: bytes[13..].to_vec(),
                })
            }
            // An answer to a wish for a file: opcode 4.
            Message::Binary(bytes) => {
                Some(Said::Status(String::from_utf8_lossy(bytes).into_owned()))
            }
            _ => None,
        }
    }
}

fn channel(value: &Value) -> Channel {
    Channel {
        id: value["id"].as_u64().unwrap(),
        topic: value["topic"].as_str().unwrap().to_owned(),
        schema: value["schemaName"].as_str().unwrap().to_owned(),
    }
}
