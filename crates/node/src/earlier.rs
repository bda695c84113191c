//! Answers requests for the earlier messages of a record, which a recorder makes that starts after the publisher.

use std::marker::PhantomData;

use anyhow::anyhow;
use messages::{Message, Topic, encode};
use zenoh::query::Query;

use crate::boxed::BoxFuture;
use crate::session::Node;
use crate::topics::QueryMailbox;

/// Maximum number of requests that wait; the oldest goes.
const MAX_WAITING: usize = 16;

/// Receives the requests for the earlier messages of a topic.
pub struct EarlierRequests<M> {
    queryable: QueryMailbox,
    message: PhantomData<fn(M)>,
}

/// A request for the earlier messages of a topic; it ends when this is dropped.
pub struct EarlierRequest<M> {
    query: Query,
    message: PhantomData<fn(M)>,
}

impl Node {
    /// The requests for the earlier messages of a topic, which must be a record ([`messages::Delivery::Record`]). A
    /// [`crate::Tap`] sends one after it has subscribed.
    ///
    /// # Errors
    /// When the session is closed.
    pub async fn earlier_requests<M: Message>(
        &self,
        topic: Topic<M>,
    ) -> anyhow::Result<EarlierRequests<M>> {
        let queryable = self.queryable(topic.key(&[]), MAX_WAITING).await?;
        Ok(EarlierRequests { queryable, message: PhantomData })
    }
}

impl<M: Message> EarlierRequests<M> {
    /// The next request; `None` once the session is closed.
    pub async fn next(&self) -> Option<EarlierRequest<M>> {
        let query = self.queryable.recv_async().await.ok()?;
        Some(EarlierRequest { query, message: PhantomData })
    }
}

impl<M: Message> EarlierRequest<M> {
    /// Sends one of the earlier messages to the requester.
    ///
    /// # Errors
    /// When it cannot be sent.
    pub async fn send(&self, message: &M) -> anyhow::Result<()> {
        send(&self.query, encode(message)).await
    }
}

fn send(query: &Query, bytes: Vec<u8>) -> BoxFuture<'_, anyhow::Result<()>> {
    Box::pin(async move {
        let sent = query.reply(query.key_expr().clone(), bytes).await;
        sent.map_err(|cause| anyhow!("sending an earlier message of {}: {cause}", query.key_expr()))
    })
}
