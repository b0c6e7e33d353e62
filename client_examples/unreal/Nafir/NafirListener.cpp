#include "NafirListener.h"

#include "Camera/PlayerCameraManager.h"
#include "IWebSocket.h"
#include "Kismet/GameplayStatics.h"
#include "WebSocketsModule.h"

namespace
{
	nafir::Vector ToNafir(const FVector& From)
	{
		return {From.X, From.Y, From.Z};
	}

	nafir::Pose PoseAt(const FVector& Location, const FQuat& Rotation)
	{
		return nafir::FromUnreal(ToNafir(Location), {Rotation.X, Rotation.Y, Rotation.Z, Rotation.W});
	}

	std::string ToText(const FString& From)
	{
		return TCHAR_TO_UTF8(*From);
	}

	FString FromText(const std::string& From)
	{
		return FString(UTF8_TO_TCHAR(From.c_str()));
	}

	nafir::Pose HeadPose(const UObject* World, int32 Player)
	{
		const APlayerCameraManager* Camera = UGameplayStatics::GetPlayerCameraManager(World, Player);
		return Camera ? PoseAt(Camera->GetCameraLocation(), Camera->GetCameraRotation().Quaternion()) : nafir::Pose();
	}

	/** The id of another player's listener. */
	std::string NameOf(int32 Player)
	{
		return "player" + std::to_string(Player);
	}

	/** What a session or the ears of a listener have to play; silence without any. */
	template <typename Source>
	int32 Fill(Source* From, float* OutAudio, int32 NumSamples)
	{
		if (From)
		{
			From->Read(OutAudio, static_cast<std::size_t>(NumSamples / 2));
		}
		else
		{
			FMemory::Memzero(OutAudio, NumSamples * sizeof(float));
		}
		return NumSamples;
	}
}

bool UNafirListener::Init(int32& SampleRate)
{
	NumChannels = 2;
	OutputRate = SampleRate;
	return true;
}

void UNafirListener::BeginPlay()
{
	Super::BeginPlay();
	PrimaryComponentTick.SetTickFunctionEnable(true);

	nafir::SessionOptions Options;
	Options.scene = ToText(Scene);
	Options.sample_rate = OutputRate;
	Options.output_rate = OutputRate;
	Options.target_s = Buffer;
	Options.give_up_after_s = GiveUpAfter;
	Options.listeners = static_cast<std::size_t>(Listeners > 1 ? Listeners : 1);
	Session = std::make_unique<nafir::Session>(Options);
	Session->on_state = [this](nafir::State State)
	{
		OnStateChanged.Broadcast(static_cast<ENafirState>(State), FromText(Session->problem()));
	};
	Session->on_emitter_ended = [this](const std::string& Id)
	{
		OnEmitterEnded.Broadcast(FromText(Id));
	};
	Session->on_emitter_refused = [](const std::string& Id, const std::string& Why)
	{
		UE_LOG(LogTemp, Warning, TEXT("Nafir: emitter %s: %s"), *FromText(Id), *FromText(Why));
	};
	Session->on_listener_refused = [](const std::string& Id, const std::string& Why)
	{
		UE_LOG(LogTemp, Warning, TEXT("Nafir: listener %s: %s"), *FromText(Id), *FromText(Why));
	};
	Session->SetListener(HeadPose(this, 0));
	Heard.store(Session.get(), std::memory_order_release);
	Connect();
	Start();
}

void UNafirListener::EndPlay(const EEndPlayReason::Type EndPlayReason)
{
	Stop();
	if (Socket)
	{
		Socket->Close(1000);
		Socket.Reset();
	}
	Super::EndPlay(EndPlayReason);
}

void UNafirListener::Connect()
{
	Session->Begin();
	TMap<FString, FString> Headers;
	if (!Key.IsEmpty())
	{
		Headers.Add(TEXT("Authorization"), TEXT("Bearer ") + Key);
	}
	Message.Reset();
	Socket = FWebSocketsModule::Get().CreateWebSocket(Url, TEXT(""), Headers);

	// What an older socket still has to say is about another connection.
	TWeakPtr<IWebSocket> Own = Socket;
	Socket->OnConnected().AddLambda([this, Own]
	{
		if (Own.Pin() == Socket)
		{
			Socket->Send(FromText(Session->FirstMessage()));
		}
	});
	Socket->OnConnectionError().AddLambda([this, Own](const FString& Error)
	{
		if (Own.Pin() == Socket)
		{
			Disconnect(Error, 0);
		}
	});
	Socket->OnClosed().AddLambda([this, Own](int32 StatusCode, const FString& Reason, bool bWasClean)
	{
		if (Own.Pin() == Socket)
		{
			Disconnect(Reason, bWasClean ? StatusCode : 0);
		}
	});
	Socket->OnMessage().AddLambda([this, Own](const FString& Text)
	{
		if (Own.Pin() == Socket)
		{
			Session->Receive(ToText(Text));
		}
	});
	Socket->OnBinaryMessage().AddLambda([this, Own](const void* Data, SIZE_T Size, bool bIsLastFragment)
	{
		if (Own.Pin() == Socket)
		{
			HandleBinary(Data, Size, bIsLastFragment);
		}
	});
	Socket->Connect();
}

void UNafirListener::Disconnect(const FString& Why, int32 Code)
{
	Socket.Reset();
	Session->Lost(ToText(Why), Code);
}

void UNafirListener::HandleBinary(const void* Data, SIZE_T Size, bool bIsLastFragment)
{
	Message.Append(static_cast<const uint8*>(Data), static_cast<int32>(Size));
	if (bIsLastFragment)
	{
		Session->ReceiveBlock(Message.GetData(), static_cast<std::size_t>(Message.Num()));
		Message.Reset();
	}
}

int32 UNafirListener::OnGenerateAudio(float* OutAudio, int32 NumSamples)
{
	return Fill(Heard.load(std::memory_order_acquire), OutAudio, NumSamples);
}

void UNafirListener::TickComponent(float DeltaTime, ELevelTick TickType, FActorComponentTickFunction* ThisTickFunction)
{
	Super::TickComponent(DeltaTime, TickType, ThisTickFunction);
	if (!Session)
	{
		return;
	}
	Session->SetListener(HeadPose(this, 0));
	switch (Session->Step(DeltaTime))
	{
	case nafir::Session::Todo::kConnect:
		Connect();
		break;
	case nafir::Session::Todo::kDrop:
		if (Socket)
		{
			Socket->Close();
		}
		Disconnect(TEXT("the server is silent"), 0);
		break;
	case nafir::Session::Todo::kNothing:
		break;
	}
	while (Socket && Socket->IsConnected())
	{
		const auto Next = Session->Take();
		if (!Next)
		{
			break;
		}
		if (Next->is_text)
		{
			Socket->Send(FromText(Next->data));
		}
		else
		{
			Socket->Send(Next->data.data(), Next->data.size(), true);
		}
	}
}

void UNafirListener::AddClip(const FString& Id, const FString& Clip, FVector Location, float GainDb)
{
	if (Session)
	{
		nafir::Source Source;
		Source.clip = ToText(Clip);
		Source.pose = PoseAt(Location, FQuat::Identity);
		Source.gain_db = GainDb;
		Session->SetEmitter(ToText(Id), Source);
	}
}

FString UNafirListener::PlayOnce(const FString& Clip, FVector Location, float GainDb)
{
	return Session ? FromText(Session->PlayOnce(ToText(Clip), PoseAt(Location, FQuat::Identity), GainDb)) : FString();
}

void UNafirListener::MoveEmitter(const FString& Id, FVector Location, FRotator Rotation)
{
	if (Session)
	{
		Session->MoveEmitter(ToText(Id), PoseAt(Location, Rotation.Quaternion()));
	}
}

void UNafirListener::SetGain(const FString& Id, float GainDb, float RampSeconds)
{
	if (Session)
	{
		Session->SetGain(ToText(Id), GainDb, RampSeconds);
	}
}

void UNafirListener::SetDoor(const FString& Door, float Openness)
{
	if (Session)
	{
		Session->SetDoor(ToText(Door), Openness);
	}
}

void UNafirListener::StopEmitter(const FString& Id, float FadeSeconds)
{
	if (Session)
	{
		Session->StopEmitter(ToText(Id), FadeSeconds);
	}
}

void UNafirListener::RemoveEmitter(const FString& Id)
{
	if (Session)
	{
		Session->RemoveEmitter(ToText(Id));
	}
}

bool UNafirAddedListener::Init(int32& SampleRate)
{
	NumChannels = 2;
	return true;
}

void UNafirAddedListener::BeginPlay()
{
	Super::BeginPlay();
	PrimaryComponentTick.SetTickFunctionEnable(true);
	Start();
}

void UNafirAddedListener::EndPlay(const EEndPlayReason::Type EndPlayReason)
{
	Stop();
	if (Ears && Listener && Listener->GetSession())
	{
		Listener->GetSession()->RemoveListener(NameOf(Player));
	}
	Super::EndPlay(EndPlayReason);
}

int32 UNafirAddedListener::OnGenerateAudio(float* OutAudio, int32 NumSamples)
{
	return Fill(Heard.load(std::memory_order_acquire), OutAudio, NumSamples);
}

void UNafirAddedListener::TickComponent(float DeltaTime, ELevelTick TickType, FActorComponentTickFunction* ThisTickFunction)
{
	Super::TickComponent(DeltaTime, TickType, ThisTickFunction);
	nafir::Session* const Session = Listener ? Listener->GetSession() : nullptr;
	if (!Session)
	{
		return;
	}
	const nafir::Pose Pose = HeadPose(this, Player);
	if (Ears)
	{
		Session->MoveListener(NameOf(Player), Pose); // one who was refused is not there
		return;
	}
	Ears = Session->AddListener(NameOf(Player), Pose, ToText(Head));
	Heard.store(Ears.get(), std::memory_order_release);
}
