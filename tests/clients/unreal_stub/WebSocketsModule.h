#pragma once

#include "IWebSocket.h"

class FWebSocketsModule {
 public:
  static FWebSocketsModule& Get();
  TSharedPtr<IWebSocket> CreateWebSocket(const FString& url, const FString& protocol, const TMap<FString, FString>& headers);
};
